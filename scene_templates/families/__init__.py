"""Which kinds of scenes a build draws from."""
