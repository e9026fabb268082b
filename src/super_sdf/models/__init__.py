"""The networks that come with super-sdf, and their card."""
