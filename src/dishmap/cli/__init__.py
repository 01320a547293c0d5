"""The program `dishmap`: the only place that parses words, prints and exits."""

from dishmap.cli.app import main

__all__ = ["main"]
