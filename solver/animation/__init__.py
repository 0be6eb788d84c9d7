"""What muscles, jaw, head and eyes do over time: from keys, or from a recording."""
