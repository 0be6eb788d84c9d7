"""Anatomy and face models of others, fetched from their owners when somebody asks for them."""
