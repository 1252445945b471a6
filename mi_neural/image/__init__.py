"""An image that exists: files (EXR, PNG), error metrics, mean and variance of its passes, the denoiser."""
