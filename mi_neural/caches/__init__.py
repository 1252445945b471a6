"""What is learned: fields, their encodings and losses, and the caches made of them."""
