"""PeopleSnapshot: its original layout, InstantAvatar's and GaussianAvatar's."""
