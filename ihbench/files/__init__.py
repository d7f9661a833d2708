"""Files that come from elsewhere: one reader for each kind."""
