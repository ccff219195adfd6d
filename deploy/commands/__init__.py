"""One module for each command of `handfast`: its options, and what it does with them."""
