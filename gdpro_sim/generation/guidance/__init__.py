"""Who judges the pictures: diffusion models, and closed-form scores of known pictures."""
