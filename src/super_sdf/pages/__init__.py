"""Pages for a browser: reports of conversions, and a viewer of meshes."""
