"""`python -m ewif_jax` is the command `ewif-jax`."""

from ewif_jax.study.cli import main

if __name__ == "__main__":
    main()
