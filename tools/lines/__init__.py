"""Lines and trains of others: their files, and the scenarios made of them."""
