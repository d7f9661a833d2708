"""Reports: tables of finished runs."""
