"""Worker processes on other machines, or on this one, that Dask runs (extra ``cluster``).

``connecting`` reaches them, ``checking`` says before the work what they lack, ``pool`` gives them
tasks as ``machine.pool`` gives them to processes of this machine, and ``serving`` is their side.
"""
