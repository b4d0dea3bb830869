"""What everything works on, as NumPy arrays: scenes, cameras, and where to put cameras that nobody gave. No device."""
