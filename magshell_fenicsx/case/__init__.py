"""Cases and what they ask for, validated once."""
