"""Surface elements: discs estimated from points, their pictures, and the light that reaches them."""
