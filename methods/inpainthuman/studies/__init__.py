"""What the method is worth and where it ends: ablations, ceiling, painters compared, stress cases."""
