"""What is known about the result: error metrics, EXR files, benchmarks, reports."""
