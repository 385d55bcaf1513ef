"""What moves multipliers and tells losses of violations, once for each batch."""
