"""What is traced: path vertices, training records, termination, estimators as functions of samples."""
