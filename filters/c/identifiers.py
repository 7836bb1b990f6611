"""Which names a filter in C may have: none that C, C++, their libraries or the files themselves use."""

from __future__ import annotations

import re
from collections.abc import Iterable

KEYWORDS = frozenset(  # of C99 to C23 and C++20, and tokens that C++ writes as words
    "alignas alignof and and_eq asm auto bitand bitor bool break case catch char char8_t char16_t char32_t class "
    "co_await co_return co_yield compl concept const const_cast consteval constexpr constinit continue decltype "
    "default delete do double dynamic_cast else enum explicit export extern false float for friend goto if inline "
    "int long main mutable namespace new noexcept not not_eq nullptr operator or or_eq private protected public "
    "register reinterpret_cast requires restrict return short signed sizeof static static_assert static_cast std "
    "struct switch template this thread_local throw true try typedef typeid typename typeof typeof_unqual union "
    "unsigned using virtual void volatile wchar_t while xor xor_eq".split()
)
HEADERS = frozenset(  # NAME.h would hide them
    "assert complex ctype errno fenv float inttypes iso646 limits locale math setjmp signal stdalign stdarg "
    "stdatomic stdbit stdbool stdckdint stddef stdint stdio stdlib stdnoreturn string tgmath threads time uchar "
    "unistd wchar wctype".split()
)
MACROS = re.compile(
    "NAN|INFINITY|NULL|EOF|BUFSIZ|FILENAME_MAX|FOPEN_MAX|MB_CUR_MAX|MAXFLOAT|I|DOMAIN|SING|OVERFLOW|UNDERFLOW|PLOSS|"
    "TLOSS|linux|unix|i386|errno|stdin|stdout|stderr|signgam|assert|"
    "P_tmpdir|L_(tmpnam|ctermid|cuserid)|(HUGE_VAL|SNAN)[A-Z0-9]*|"
    "(FP|M|MATH|SEEK|EXIT|RAND|TMP|SIZE|PTRDIFF|SIG|WCHAR|WINT|FLT|DBL|LDBL)_[A-Z0-9_]*|"
    "(U?INT(PTR|MAX|(_LEAST|_FAST)?(8|16|32|64))|U?CHAR|U?SHRT|U?INT|U?L?LONG)_[A-Z]+"
)
OF_MATH = (  # and with an f or l behind them
    "acos acosh asin asinh atan atan2 atanh cbrt ceil copysign cos cosh drem erf erfc exp exp10 exp2 expm1 "
    "fabs fdim finite floor fma fmax fmin fmod frexp gamma gamma_r hypot ilogb isinf isnan j0 j1 jn ldexp "
    "lgamma lgamma_r llrint llround log log10 log1p log2 logb lrint lround modf nan nearbyint nextafter "
    "nexttoward pow pow10 remainder remquo rint round roundeven scalb scalbln scalbn significand sin sincos "
    "sinh sqrt tan tanh tgamma trunc y0 y1 yn"
).split()
OF_OTHERS = (
    "fpclassify isfinite isnormal signbit isgreater isgreaterequal isless islessequal islessgreater "
    "isunordered math_errhandling offsetof abort abs alloca atexit atof atoi atol atoll bcmp bcopy bsearch "
    "bzero calloc clearerr ctermid div dprintf drand48 ecvt erand48 exit fclose fcvt fdopen feof ferror "
    "fflush ffs fgetc fgetpos fgets fileno fopen fprintf fputc fputs fread free freopen fscanf fseek fsetpos "
    "ftell fwrite gcvt getc getchar getdelim getenv getline gets getw index initstate jrand48 labs ldiv llabs "
    "lldiv lrand48 malloc mblen mbstowcs mbtowc memccpy memchr memcmp memcpy memmove memset mktemp mrand48 "
    "nrand48 pclose perror popen printf putc putchar putenv puts putw qsort rand random realloc realpath "
    "remove rename rewind rindex scanf select setbuf setenv setstate setvbuf snprintf sprintf srand srandom "
    "sscanf stpcpy strcat strchr strcmp strcoll strcpy strcspn strdup strerror strlen strncat strncmp strncpy "
    "strnlen strpbrk strrchr strsep strsignal strspn strstr strtod strtof strtok strtol strtold strtoll "
    "strtoul strtoull strxfrm system tempnam tmpfile tmpnam ungetc unsetenv valloc vfprintf vfscanf vprintf "
    "vscanf vsnprintf vsprintf vsscanf wcstombs wctomb write read"
).split()
OF_LIBRARIES = frozenset([*OF_OTHERS, *(name + kind for name in OF_MATH for kind in ("", "f", "l"))])
FUNCTIONS = "{0}_init", "{0}_predict", "{0}_update", "{0}_test_anew", "{0}_channel"  # of a filter of this name


def is_name(text: str) -> bool:
    """Whether text is letters, digits and _, begins with a letter, and is no keyword of C or C++."""
    return bool(re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", text, flags=re.ASCII)) and text not in KEYWORDS


def is_macro(text: str) -> bool:
    """Whether headers of C replace a name by something else."""
    return bool(MACROS.fullmatch(text))


def is_taken(name: str, texts: Iterable[str]) -> bool:
    """Whether a filter cannot have a name: libraries of C declare it, as do types that end in _t, or its files do.

    Args:
        name: of letters, digits and _.
        texts: the files of the same filter under another name.
    """
    if name in OF_LIBRARIES or name in HEADERS or name == "board" or name.endswith("_t") or is_macro(name):
        return True
    used = {word for text in texts for word in re.findall(r"[A-Za-z_]\w*", _without_comments(text))}
    return not used.isdisjoint([name, *(one.format(name) for one in FUNCTIONS)])


def _without_comments(text: str) -> str:
    """A text of C without its comments, strings and characters, of which one may be a quote."""
    return re.sub(r"""/\*.*?\*/|"(?:\\.|[^"\\])*"|'(?:\\.|[^'\\])+'""", " ", text, flags=re.S)
