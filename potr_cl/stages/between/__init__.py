"""What the stage "between" computes with: trial.py finds out how many views a scene needs between its own."""
