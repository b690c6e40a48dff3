"""The extended Kalman filter on the arrowhead: section 4.3 and Fig. 10 of Yoder et al."""
