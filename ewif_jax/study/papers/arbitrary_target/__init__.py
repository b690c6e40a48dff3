"""Fig. 2 of Shulami & Sigalov: one EWIF as filter and as smoother, with and without the late
sensor; and the estimate that looks both ways."""
