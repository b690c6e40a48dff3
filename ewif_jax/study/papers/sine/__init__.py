"""The sine experiment of Shulami & Sigalov, section V-C and Fig. 1, and its optimum by gradient."""
