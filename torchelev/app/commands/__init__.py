"""Options and help texts of the commands. Each imports the module that does its work when it runs."""
