"""Ratios against the physics floor, other libraries and hand-written code, each in one run."""
