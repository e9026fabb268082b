"""Many grids, or one huge grid, on worker processes that Dask runs (extra ``cluster``).

``connecting`` reaches the workers, ``checking`` says before the work what they lack, ``crew`` gives
them tasks; ``bricks`` converts one grid, whose planes ``stored`` reads.
"""
