"""How well a mesh fits its grid's samples, without the true surface, and whether it is valid."""
