"""What each merge told, with the poses it was told from: moved when a pose graph corrects the past."""
