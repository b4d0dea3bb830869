"""What happens at the limits, and on every device."""
