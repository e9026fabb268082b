"""Refined fields as files: sparse ``.npz``, which is read back, dense ``.npy`` and ``.vti``."""
