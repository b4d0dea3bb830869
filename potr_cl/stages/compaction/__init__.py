"""What the stage "compact" computes with: a ridge regression for each splat. Begin with ridge.py."""
