"""How soon the map shows new obstacles, and whether those that left disappear from it."""
