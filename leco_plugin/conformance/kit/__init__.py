"""What every rule needs: scenes in which everything is known, and ways to look on."""
