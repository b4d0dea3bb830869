"""What only tests compare with: a decoder written from docs/format.md alone, a renderer in PyTorch."""
