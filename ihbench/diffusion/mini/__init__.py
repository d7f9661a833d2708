"""The small backbone that this project trains on its own procedural people, and ships."""
