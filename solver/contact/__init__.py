"""What must not go into each other: lips, teeth, lids, eyes, and objects from outside."""
