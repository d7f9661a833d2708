"""OcMotion: its original layout, and Wild2Avatar's."""
