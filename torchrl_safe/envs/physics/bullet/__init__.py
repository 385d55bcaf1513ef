"""PyBullet: nothing outside this folder imports or names it."""
