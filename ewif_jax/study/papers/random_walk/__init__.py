"""Random walks of Yoder et al., section 4.1 and Figs. 4-6: up to which delay is a late measurement
worth its while?"""
