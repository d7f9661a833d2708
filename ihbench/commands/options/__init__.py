"""Options that several commands share, and how a command line becomes them."""
