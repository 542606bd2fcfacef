"""``python -m dvi_jax``: the command line."""

from dvi_jax_cli import main

if __name__ == "__main__":
    main()
