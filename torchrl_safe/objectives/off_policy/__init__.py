"""Losses of replayed data."""
