"""Independent answers that the metrics are held against: oracles, other libraries, stored values."""
