"""The coarse input: its samples, and what they say of sign and spacing.

It may import ``machine`` and ``errors``.
"""
