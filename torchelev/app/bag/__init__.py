"""`torchelev bag`: what a bag holds, and the command that maps it."""
