"""What runs have in common: supervised worker processes, files of lines that are only appended."""
