"""The arrowhead of Yoder et al., section 4.2 and Figs. 7-9: when a late measurement does harm."""
