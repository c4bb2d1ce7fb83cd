"""What all other rooms use: double precision, checks of arguments, kept programs, small linear systems, progress."""
