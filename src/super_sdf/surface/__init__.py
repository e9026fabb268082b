"""From a fine field to a mesh."""
