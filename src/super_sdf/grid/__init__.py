"""The coarse input: its samples, and the sign and spacing that are inferred from them."""
