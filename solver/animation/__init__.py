"""Motion of muscles, jaw, head and eyes over time: from keys, or from a recording."""
