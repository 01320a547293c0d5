"""Measured points and the surfaces through them."""
