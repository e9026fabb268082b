"""What a run may use: threads, memory, packages, worker processes, append-only records.

It may import ``errors`` alone.
"""
