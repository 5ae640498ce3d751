"""Which runs share a program, how they are laid on devices, what they need, and how far they are."""
