"""What the stage "fit" computes with.

- derivatives.py goes from numbers for pixels back to the splats' parameters, which launcher.py runs on a device.
"""
