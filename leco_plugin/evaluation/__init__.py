"""How a trained model is judged: image metrics and the comparisons built on them."""
