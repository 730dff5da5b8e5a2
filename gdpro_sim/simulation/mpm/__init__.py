"""Material point method: particles carry the matter, a grid moves them."""
