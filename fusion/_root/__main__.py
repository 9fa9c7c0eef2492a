"""`python -m terrafusion`: the command line, where its script is not on the path."""

from terrafusion.fusion.cli.main import main

if __name__ == "__main__":
    main()
