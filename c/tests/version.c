/* Prints the versions of the header and of the library. */
#include "conicflow.h"

#include <stdio.h>

int main(void) {
    printf("%s %s\n", CONICFLOW_VERSION, conicflow_version());
    return 0;
}
