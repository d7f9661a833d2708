"""What several methods' networks are made of."""
