"""``python -m mi_neural``: the command line, where the program ``mi-neural`` is not on the path."""

from mi_neural.cli import main

if __name__ == "__main__":
    main()
