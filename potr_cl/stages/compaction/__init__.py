"""What the stage "compact" computes with: a ridge regression a splat."""
