"""What a case needs: mesh sizes, terms, supports, symmetry, limits. Made from a case without any mesh."""
