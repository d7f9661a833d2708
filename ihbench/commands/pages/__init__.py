"""Commands that show finished runs: pictures, films, files for other programs, pages for a browser."""
