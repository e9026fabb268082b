"""From a grid to its fine field: the band, the nodes, the fit to the samples."""
