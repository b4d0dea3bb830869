"""What people and programs are told: summaries, pages, what a file or a device is."""
