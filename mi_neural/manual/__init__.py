"""The manual: plugins' pages out of their docstrings, and the guides beside this file."""
