"""Views and what they see: visibility, plans of views, and the engine that brings them in."""
