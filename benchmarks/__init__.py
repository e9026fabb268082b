"""Commands that measure quality, speed and robustness of super-sdf and print tables."""
