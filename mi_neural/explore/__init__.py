"""Looking at scenes and caches: figures and live views."""
