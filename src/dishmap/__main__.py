"""`python -m dishmap` is `dishmap`."""

from dishmap.cli.app import main

main()
