"""What living flesh does: checks against known answers, contact, sliding, speed, effects."""
