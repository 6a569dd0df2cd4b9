"""What the papers claim, measured through the product: one file a paper, one row a claim."""
