"""What happens at the limits and on every device: run.py measures, cases.py has the inputs, fuzz.py damages files."""
