"""The command line as ``python -m acquire``."""

from acquire.cli.main import main

if __name__ == "__main__":
    main()
