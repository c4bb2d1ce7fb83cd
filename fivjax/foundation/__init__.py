"""What every room stands on: double precision, compiling, checks of arguments, small linear systems."""
