"""A fleet on its own computers: installed, started, upgraded, watched and fetched from, over ssh."""
