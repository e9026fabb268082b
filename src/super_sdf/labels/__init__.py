"""All labels of a volume as meshes with shared walls."""
