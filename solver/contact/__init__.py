"""Contact of lips, teeth, lids, eyes, and objects from outside."""
