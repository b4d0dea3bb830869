"""From a file's integers to values in a device's memory, without a scene on the host."""
