"""``python -m dvi_jax_cli``: the command line without its script."""

from ._main import main

if __name__ == "__main__":
    main()
