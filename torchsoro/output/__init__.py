"""What a run leaves for people: printable parts, pictures, movies, pages, archived designs."""
