"""Speed against error: rendering to a time or a number of samples, comparisons, sequences, references, reports."""
