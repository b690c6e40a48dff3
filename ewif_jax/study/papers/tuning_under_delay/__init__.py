"""A cut-off learned together with q of Al1, and with tau of the EWIF, by gradient through late
measurements: the arrowhead of Yoder et al. again."""
