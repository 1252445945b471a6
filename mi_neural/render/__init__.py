"""How an image comes about: camera rays, paths, films, recorded functions. No module here knows a plugin."""
