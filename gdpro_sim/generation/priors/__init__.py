"""Where the coarse mesh comes from."""
