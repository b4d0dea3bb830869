"""What the stage "merge" computes with: merged.py."""
