"""Run the command ``myoface`` as ``python -m myoface``."""

from myoface.cli import main

if __name__ == "__main__":
    main()
