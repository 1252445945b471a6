"""What is traced: path vertices, training paths, termination, sample sequences. No module here knows a plugin."""
