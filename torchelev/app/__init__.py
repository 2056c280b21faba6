"""The command line, its demo and the reports they print. Library code never imports this package."""
