"""What the stage "refit" computes with: the linear map from colours to pictures, and its solver."""
