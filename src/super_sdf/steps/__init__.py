"""The steps of the method, each a function from arrays to arrays.

They may import ``network`` and the rooms below it, but not ``files``.
"""
