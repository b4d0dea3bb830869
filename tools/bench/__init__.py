"""How fast and how large: each module measures one subject."""
