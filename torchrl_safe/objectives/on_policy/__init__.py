"""Losses of on-policy data, and the one way to constrain them."""
