"""The optional machine code of a few steps (extra ``fast``)."""
