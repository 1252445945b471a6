"""The commands of `mi-neural`, one a file."""
