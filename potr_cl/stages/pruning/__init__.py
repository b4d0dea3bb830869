"""What the stage "prune" computes with: removal effects, and who decides by them what goes."""
