"""The commands of `handfast`, in one module each: its arguments, and what it does with them."""
