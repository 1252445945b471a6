"""Counterparts of the figures and tables of the sources, each rendered by `mi-neural reproduce NAME`."""
