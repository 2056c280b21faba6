"""`torchelev site`: what the command line does with a site map."""
